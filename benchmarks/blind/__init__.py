"""Sealed measurement campaigns with hidden effects, and the score of whoever names them.

Nothing here comes from the code that names effects: structures are full finite element models or
small matrices, effects act on them as physics, the motion is integrated by another scheme (`laws`,
`paths`).
"""
