"""Tracking laws."""
