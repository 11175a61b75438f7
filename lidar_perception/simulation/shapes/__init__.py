"""The things in a street, as rows of PART (solids.py).

Every thing has a frame of its own: x forward, y left, z up from the ground below its origin;
metres, radians. What KITTI labels comes as a Thing (thing.py), with the size of its box; all else
is (P,) PART. Reflectances are those that KITTI's sensor reports for such surfaces seen straight.
"""
