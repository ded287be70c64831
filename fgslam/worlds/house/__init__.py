"""A wheelchair with an omnidirectional camera in a rendered house: settings, world, people."""
