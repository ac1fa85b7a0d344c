"""The calibration of the parameters of any model from a campaign: record, file, page and folder."""
