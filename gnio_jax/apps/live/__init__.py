"""Odometry while samples come: what `gnio live` does.

    source → one clock → in order, with both sensors → rate, units and sign → tracker → path, page

A stream does not describe itself. Its rate and the unit of its accelerometer are measured over its
first second, in which the device must be still in any case. Every stage takes arrivals and gives
arrivals, so a further source is one entry in the table of `sources`.
"""
