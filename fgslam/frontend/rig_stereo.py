"""Stereo features of a frame, from the features that were found in it.

Of the reference image they are measured in the other images by their patches
(:mod:`fgslam.frontend.patch_stereo`); or those of all images are matched by their descriptors
(:mod:`fgslam.frontend.stereo`).
"""

from __future__ import annotations

from fgslam.core.features import Features, StereoFeatures
from fgslam.core.recordings import Frame
from fgslam.core.rig_correction import RigCorrection
from fgslam.frontend.patch_stereo import PatchStereo
from fgslam.frontend.stereo import StereoMatcher


class RigStereo:
    """Measures features in all of a rig's images, whichever they were found in."""

    def __init__(self, matcher: StereoMatcher, patches: PatchStereo, by_patches: bool) -> None:
        """Takes what matches features of all images, and what measures those of the first.

        ``by_patches``: whether the latter is asked whatever images have features.
        """
        self._matcher = matcher
        self._patches = patches
        self._by_patches = by_patches

    def match(
        self,
        frame: Frame | None,
        features: tuple[Features, ...],
        correction: RigCorrection | None = None,
    ) -> StereoFeatures:
        """What all images show, then what only two of three do; empty without features.

        Args:
            frame: the images, right, left[, top]; patches need them.
            features: of the right image, or of each.
            correction: of the rig; None where its calibration is taken as stated.
        """
        if not features:
            return StereoFeatures.empty()
        if frame is not None and (self._by_patches or len(features) == 1):
            return self._patches.match(frame, features[0], correction)
        return self._matcher.match_all(features, correction)
