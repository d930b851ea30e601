"""Independent checks of certificate files, which share no code with what made them."""
