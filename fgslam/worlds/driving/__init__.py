"""How robots move through places: paths, free floor, wheels, wheelchair, range sensor."""
