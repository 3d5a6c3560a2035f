"""Learning q(θ | recordings): encoders, mixture head, features, fit, proposals, calibration."""
