# SPDX-License-Identifier: Apache-2.0

"""What of an address stays out of tables, pages and messages."""

from adxl_ros.files.plain_address import without_secrets
import pytest


@pytest.mark.parametrize('query, kept', [
    ('token=SECRET&x=1', '?x=1'),
    ('x=1&access_token=SECRET&y=2', '?x=1&y=2'),
    ('X-Amz-Credential=SECRET&X-Amz-Date=1&X-Amz-Signature=SECRET&versionId=3', '?versionId=3'),
    ('AWSAccessKeyId=SECRET&Signature=SECRET&Expires=17', ''),
    ('Policy=SECRET&Signature=SECRET&Key-Pair-Id=SECRET', ''),
    ('X-Goog-Algorithm=SECRET&x-goog-signature=SECRET', ''),
    ('sv=2022&se=2026&sr=b&sp=r&sig=SECRET%2F&snapshot=7', '?snapshot=7'),
    ('api%5Fkey=SECRET&apikey=SECRET', ''),
])
def test_secrets_of_a_query(query, kept):
    assert without_secrets(f'https://host/run.csv?{query}') == f'https://host/run.csv{kept}'


@pytest.mark.parametrize('text', [
    'https://host/run.csv?key=day/1.csv&signed=yes&signal=3&monkey=4',
    'https://host/run.csv?st=1&sp=2&expires=never&x=a=b&&y', 'sftp://robot@host:22/run.csv',
    'recordings/a?token=1.csv', 'https://host/run.csv?#token=1'])
def test_what_tells_recordings_apart_stays(text):
    assert without_secrets(text) == text


def test_a_text_with_addresses():
    text = "403, message='Forbidden', url='https://u:pw@host/a.csv?sig=SECRET#b' or ftp://a:b@c/d"
    assert without_secrets(text) == \
        "403, message='Forbidden', url='https://u@host/a.csv#b' or ftp://a@c/d"
