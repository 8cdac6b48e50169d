"""Ground floor: what every room speaks."""
