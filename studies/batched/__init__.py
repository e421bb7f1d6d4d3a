"""Studies of batched teams and other simpler estimators: what they change beside the environment's own."""
