"""Report pages, figure style, progress, provenance and atomic files; knows no wing and no FMU."""
