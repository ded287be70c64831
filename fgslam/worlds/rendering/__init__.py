"""Rendering of textured patch scenes: pinhole and omnidirectional images, light, textures."""
