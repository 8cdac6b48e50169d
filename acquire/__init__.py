"""Floor 1: devices to frames."""
