"""Updates of landmarks by a frame: EKF, and log-odds of existence."""
