"""Following for others to see and steer: a thread that tracks, a web page with its API, a MAVLink camera."""
