"""Filters: dead reckoning, one Kalman filter per landmark, the full EKF."""
