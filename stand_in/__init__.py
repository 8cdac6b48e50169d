"""Floor 3: photographs, clicks and silhouettes to the geometry of the set."""
