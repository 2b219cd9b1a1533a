"""The walking engine: from ten parameters to joint angles."""
