"""What a candidate is worth: evidence to P(same place), agreement in time, odometry, the verdict."""
