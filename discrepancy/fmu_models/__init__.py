"""FMUs as models of a campaign."""
