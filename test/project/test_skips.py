# SPDX-License-Identifier: Apache-2.0

"""What a run says of the tests that it has skipped."""

import needs


def test_skipped_tests_are_named_in_two_lines_with_one_command():
    reasons = [needs.lack('a browser', 'chromium')] * 2 + [
        needs.lack('libiio', 'libiio0'),
        needs.lack('../shared'),
        "could not import 'sros2': No module named 'sros2'",
    ]
    skipped, command = needs.summary(reasons)
    assert skipped == (
        'skipped 5 tests, which need: a browser (2), libiio (1), ../shared (1), sros2 (1)'
    )
    assert command.endswith('apt install chromium libiio0')
    assert len(needs.summary(reasons[-1:])) == 1
    assert needs.summary([]) == []
