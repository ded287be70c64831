"""Estimators of one homing: the paper's EKFs, the bearing-only factor graph, and baselines."""
