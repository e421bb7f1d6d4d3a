"""RobotMetrics of the paper, reproduced in simulation."""
