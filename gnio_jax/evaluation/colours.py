"""Colours and sizes that pictures, pages and Rerun's files of results share.

The colours are those of Okabe and Ito, which colour-blind readers can distinguish; the reference is
always black.
"""

BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8C8C8C"
PURPLE, ORANGE, SKY, YELLOW = "#CC79A7", "#E69F00", "#56B4E9", "#F0E442"
REFERENCE = "#000000"
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
"""One for each run, method or row."""
AXES = {"x": BLUE, "y": VERMILION, "z": GREEN}
SIGMAS = 3.0
"""Size of ellipses, ellipsoids and bands, in standard deviations."""
