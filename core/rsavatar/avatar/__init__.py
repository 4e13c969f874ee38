"""The avatar: canonical Gaussians bound to a body, their networks and their density control."""
