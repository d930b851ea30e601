"""Robot descriptions: reading and checking URDF files, and visual geometry."""
