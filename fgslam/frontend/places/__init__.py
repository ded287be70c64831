"""Place recognition: relocalisation in a map, loop closures, joining of saved maps."""
