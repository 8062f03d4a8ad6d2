"""Published deep trackers, run by their own code in their own interpreter."""
