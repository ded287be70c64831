"""Images to measurements: SIFT, stereo matching, the landmark database, ego-motion."""
