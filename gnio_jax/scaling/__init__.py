"""Training on many devices and in many processes (docs/scaling.md).

`devices` says how arrays lie on the devices, `meeting` where processes meet, `processes` what they
agree on, `endings` how they end. Everywhere else the code reads as if there were one device and one
process.
"""
