"""What runs beside a robot: monitor, controller, alarm."""
