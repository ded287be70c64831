"""Sub-maps on disk: landmarks far from the robot, until it comes near or recognises them."""
