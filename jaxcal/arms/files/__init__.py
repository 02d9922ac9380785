"""Files of arms: URDF, UR's and DH tables, recordings, servos."""
