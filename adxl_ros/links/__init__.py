# SPDX-License-Identifier: Apache-2.0

"""
Where samples come from: one file a link.

Read them in this order:

the links
    sim                     a simulated sensor
    replay                  a recording
    serial                  a microcontroller
    iio                     an ADC of Linux
    topic                   another simulator
what they are made of
    support/base            what a link is
    support/serial_port     bytes of a port that may be lost
    support/wire_format     frames of a microcontroller
    support/emulated_board  the board in software
    support/stamping        stamps by the clock of a device
    support/clock_map       that clock on the host's
    support/clock_rate      whether it keeps its rate
    support/self_test       the self-test of a sensor
"""
