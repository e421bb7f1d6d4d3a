"""Speed and quality of the stereo front end."""
