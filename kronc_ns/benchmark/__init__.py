"""What the measured figures are made of."""
