"""ROS 2 node of sglpr-jax."""
