"""Front-end of omnidirectional homing: features, matching, the homing vector, tracking."""
