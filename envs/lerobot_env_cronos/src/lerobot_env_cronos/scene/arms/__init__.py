"""The arms: each is a module of values and of the few functions in which arms differ, and one of its bodies."""
