"""ROS 2 node that runs ``ertis ros``."""
