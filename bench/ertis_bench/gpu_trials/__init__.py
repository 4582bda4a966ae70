"""Times on a GPU, beside those of other libraries and the limits of the device."""
