"""The campaign: what is done to the package so that its promises break, repeatable and bounded.

One file a part, each with case_of(seed, number) and Attempt; run.py gives every part its share of
the time and worker.py runs it in a process of its own, so that no case can end the campaign.
"""
