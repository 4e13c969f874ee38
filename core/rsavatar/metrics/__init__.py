"""Image, pose and time metrics. ``base.score`` runs every image metric of the catalogue under one stated protocol."""
