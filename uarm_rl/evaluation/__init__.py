"""Testing policies on fixed positions, and filming them."""
