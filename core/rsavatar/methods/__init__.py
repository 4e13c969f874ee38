"""One file per method: each puts a motion and a shutter together; training is the same for all."""
