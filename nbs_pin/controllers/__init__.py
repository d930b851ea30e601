"""Tracking control laws."""
