"""A bar under tension, and further parts of twins, as a plug-in of uav-twin."""
