"""Images and errors of the study of stereo measurements: rendered scenes, and real images in a folder."""
