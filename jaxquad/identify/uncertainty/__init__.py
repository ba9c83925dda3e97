"""What a fit is worth: covariance, model error, identifiability, and what follows from them."""
