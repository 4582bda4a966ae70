"""Performance of a central node: storage, images, fused images and acoustic maps, up to overload."""
