"""What crosses the borders of rooms: types, geometry, errors, logs and files."""
