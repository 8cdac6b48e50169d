"""A real circular-fisheye light probe of an office desk, named by a path the user gives."""
