"""A first configuration from bags: what drives the robot, what answers, and how to sample them."""
