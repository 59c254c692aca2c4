"""Plain functions on floats without I/O: the loop runs them as they are, the lab compiles them."""
