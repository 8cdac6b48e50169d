"""A virtual set with a known truth, photographed by emulated cameras."""
