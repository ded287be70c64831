"""What stands where: plans, furniture, and the lab, office, corridors and house made of them."""
