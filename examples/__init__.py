"""Example scenes, copied by `chromeball new --example NAME`."""
