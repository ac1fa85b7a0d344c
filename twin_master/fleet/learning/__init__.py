"""What a flown fleet teaches: evidence of shared quantities, their posterior, lessons."""
