"""Frame, particles and medium become a picture with labels."""
