"""Modules that both the driver and the workers import: messages, noise, wire format, platform and process environment.

They import no other package of this project.
"""
