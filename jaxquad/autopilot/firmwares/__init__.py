"""One file for each firmware's laws, parameters and files, and one, without JAX, for its logs."""
