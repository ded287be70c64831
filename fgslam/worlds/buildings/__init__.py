"""Buildings: floor plans of rooms, corridors and doors, and what stands in them."""
