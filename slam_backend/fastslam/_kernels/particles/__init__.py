"""All particles together: weights, resampling, storage of their landmarks, estimates over them."""
