"""The laboratory: what makes the recogniser and measures it. Never imported on a robot."""
