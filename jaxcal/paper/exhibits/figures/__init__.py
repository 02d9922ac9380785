"""What the exhibits draw, one topic a module; ``parts`` is what the figures share.

Functions take columns and return a matplotlib ``Figure``; they touch no file.
"""
