"""Environments stepped side by side, faster than one by one."""
