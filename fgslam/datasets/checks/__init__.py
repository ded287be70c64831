"""Checks of recordings, as `fgslam inspect` reports them."""
