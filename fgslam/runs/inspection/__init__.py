"""What is in a recording, and every problem found, in words."""
