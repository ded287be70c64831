"""Speed as ratios within one process, so that numbers of different machines compare."""
