"""What libraries work out anew each time, worked out once: imported by every process that runs tests or commands.

For each command line Draccus reads the source of every field's class and the signature of every action, and
LeRobot, which looks for plugins, what every installed package says of itself: most of a test's second. A dataset's
features look at all columns again for each one that is set.
"""

import email
import inspect
from functools import cache
from importlib import metadata
from types import SimpleNamespace

from datasets import Features
from datasets.features.features import require_decoding
from draccus.wrappers import docstring, field_wrapper

SET_ALL = Features.__setitem__
"""The library's own."""


def set_one(self, key, feature):
    """What is known of the other columns stays as it is."""
    dict.__setitem__(self, key, feature)
    self._column_requires_decoding[key] = require_decoding(feature)


docstring.get_attribute_docstring = cache(docstring.get_attribute_docstring)
field_wrapper.inspect = SimpleNamespace(getfullargspec=cache(inspect.getfullargspec))
metadata.email = SimpleNamespace(message_from_string=cache(email.message_from_string))
Features.__setitem__ = set_one
