"""Reference motions and disturbance torques."""
