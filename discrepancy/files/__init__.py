"""Verdict, patch and residuals on disk."""
