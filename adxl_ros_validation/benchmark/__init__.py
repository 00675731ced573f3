# SPDX-License-Identifier: Apache-2.0
"""
A benchmark of diagnoses on public recordings of real sensors.

`manifest` names the recordings, `case` is what a method gets and gives, `methods` has those that
take part, `defects` draws level A, `run` asks every method, `results` scores and shows it.
"""
