# SPDX-License-Identifier: Apache-2.0

"""What of an address stays out of tables, pages and messages."""

from adxl_ros.report.page import without_secrets
import pytest


@pytest.mark.parametrize(
    'query, kept',
    [
        ('token=SECRET&x=1', '?x=1'),
        ('x=1&access_token=SECRET&y=2', '?x=1&y=2'),
        (
            'X-Amz-Credential=SECRET&X-Amz-Date=1&X-Amz-Signature=SECRET&versionId=3',
            '?versionId=3',
        ),
        ('AWSAccessKeyId=SECRET&Signature=SECRET&Expires=17', ''),
        ('Policy=SECRET&Signature=SECRET&Key-Pair-Id=SECRET', ''),
        ('X-Goog-Algorithm=SECRET&x-goog-signature=SECRET', ''),
        ('sv=2022&se=2026&sr=b&sp=r&sig=SECRET%2F&snapshot=7', '?snapshot=7'),
        ('api%5Fkey=SECRET&apikey=SECRET', ''),
    ],
)
def test_secrets_of_a_query(query, kept):
    assert without_secrets(f'https://host/run.csv?{query}') == f'https://host/run.csv{kept}'
