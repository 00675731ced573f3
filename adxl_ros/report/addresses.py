# SPDX-License-Identifier: Apache-2.0

"""
Addresses without what opens them: passwords, and the signatures and tokens of queries.

A parameter of a query is secret if a word of its name says so, as in `access_token` and
`AWSAccessKeyId`, or if it is part of a signature. The others tell apart what the address names:
so does a plain `key`, which object stores use for a name.
"""

import re
from urllib.parse import unquote_plus

_PASSWORD = re.compile(r'(?<=://)([^/@:\s]*):[^/@\s]*@')
"""User and password of an address."""
_QUERY = re.compile(r'(?<=://)([^\s?#\'"]*)\?([^\s#\'"]*)')
"""Place and query of an address."""
_WORD = re.compile(r'[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+')
"""A word of a name such as `AWSAccessKeyId`."""
_SECRET = frozenset((
    'token', 'key', 'apikey', 'accesskey', 'secret', 'sig', 'signature', 'password', 'passwd',
    'pwd', 'credential', 'credentials', 'auth', 'authorization', 'jwt'))
"""Words of secrets."""
_SCHEMES = ('x-amz-', 'x-goog-')
"""Begins of the parameters of signatures: S3 and Google."""
_SIGNATURES = ('sig', 'signature')
"""Names of signatures that have other parameters beside them."""
_SIGNED = frozenset((
    'expires', 'policy', 'googleaccessid', 'sv', 'ss', 'srt', 'sr', 'sp', 'spr', 'sip', 'st', 'se',
    'skoid', 'sktid', 'skt', 'ske', 'sks', 'skv', 'saoid', 'suoid', 'scid', 'sdd', 'ses'))
"""Parameters beside such a signature that change with it: CloudFront, older Google and Azure."""


def without_secrets(text: str) -> str:
    """Return a text without the passwords, tokens and signatures of its addresses."""
    return _QUERY.sub(_plain_query, _PASSWORD.sub(r'\1@', text))


def as_utf_8(name: str) -> str:
    """Return the name of a file with escapes in place of what is not UTF-8."""
    return name.encode('utf-8', 'backslashreplace').decode('utf-8')


def _plain_query(match: re.Match[str]) -> str:
    """Return the place of an address with the parameters that are not secret."""
    place, query = match.groups()
    parts = query.split('&')
    names = [unquote_plus(part.partition('=')[0]) for part in parts]
    is_signed = any(name.lower() in _SIGNATURES for name in names)
    kept = [part for part, name in zip(parts, names) if not _is_secret(name, is_signed)]
    if len(kept) == len(parts):
        return match.group()
    return f'{place}?{"&".join(kept)}' if kept else place


def _is_secret(name: str, is_signed: bool) -> bool:
    """Return whether a parameter of a query is secret; `is_signed` says of a signature in it."""
    lower = name.lower()
    return (lower.startswith(_SCHEMES) or (is_signed and lower in _SIGNED) or (
        lower != 'key' and any(word.lower() in _SECRET for word in _WORD.findall(name))))
