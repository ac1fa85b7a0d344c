"""Projects of `uav-twin init`: folders that run at once, with the files of a user in them."""
