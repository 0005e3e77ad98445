"""Bags of ROS 2."""
