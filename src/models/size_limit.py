"""The largest size of a network, by itself: it is read without the networks."""

MAX_SIZE = 4096  # any number in the arguments of a network of this project
