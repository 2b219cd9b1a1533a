"""A walking engine with ten parameters (Abdolmaleki et al. 2016, Section 2)."""
