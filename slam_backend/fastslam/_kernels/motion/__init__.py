"""Motion model: predicted, sampled, and with the odometry bias."""
