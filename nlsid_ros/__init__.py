"""ROS 2 nodes (rclpy): recorder, funnel publisher, funnel monitor; thin, the logic is below."""
