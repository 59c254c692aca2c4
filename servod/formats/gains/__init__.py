"""Gain sets: parameters, design, certificate, store."""
