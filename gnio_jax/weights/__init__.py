"""Packages of trained networks that the wheel brings (`gnio weights`), one folder or zip each."""
