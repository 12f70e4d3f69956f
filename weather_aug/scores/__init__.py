"""What weather did to a picture, measured: steadiness over time and views, a network's labels."""
