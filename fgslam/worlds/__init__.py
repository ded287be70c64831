"""Rendered and simulated worlds with exact ground truth; only `datasets` opens them."""
