"""A run from its configuration to its folder: loop, checkpoints, results, pictures, exports."""
