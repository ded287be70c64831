"""What crosses the borders of rooms: values, geometry, errors, files.

Values are frozen dataclasses of plain NumPy arrays. Frames and units, everywhere in the package:

* ``wTc`` takes a point from camera to world coordinates; poses are 4x4 homogeneous matrices.
* The camera is the rig's *reference* camera: the right one, as in Se, Lowe and Little (2001, 2.2).
* Camera axes: x right, y down, z forward. The world is the reference camera's first frame.
* Metres, radians, seconds, pixels; the centre of the top-left pixel is (0, 0).
* Tangent vectors and 6x6 covariances are ordered [rotation, translation] and live in the
  tangent space at the estimate: ``T = T_estimate * Exp(xi)``, as in GTSAM.
"""

__version__ = "0.2.0.dev0"
