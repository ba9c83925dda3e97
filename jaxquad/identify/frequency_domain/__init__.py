"""Fits of models to frequency responses: the weighted cost and its Gauss-Newton descent."""
