"""Ground floor: what every room speaks (scene file, cameras, poses, images, records, errors)."""
