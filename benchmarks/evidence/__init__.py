"""Accuracy on the committed experiments; `python -m benchmarks NAME` prints one set of tables."""
