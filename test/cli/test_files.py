# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Options for bags and for tables, beside the records of a call."""

from types import SimpleNamespace

from piezo_ident.cli.files import check_bag_options
from piezo_ident.common.errors import ConfigError
import pytest


@pytest.mark.parametrize(
    ('names', 'option', 'refusal'),
    [
        (['t.csv'], 'namespace', '--namespace is for bags, and .*t.csv is a table'),
        (['t.csv'], 'rate', ''),
        (['b.mcap', 'folder'], 'rate', '--rate is for tables, and .*b.mcap is a bag'),
        (['folder'], 'voltage_topic', ''),
        (['t.csv', 'b.mcap'], 'namespace', ''),
        (['t.csv', 'b.mcap'], 'rate', ''),
        (['absent.csv'], 'namespace', ''),
    ],
)
def test_options_are_refused_if_no_record_takes_them(tmp_path, names, option, refusal):
    (tmp_path / 'folder').mkdir()
    for name in ('t.csv', 'b.mcap'):
        (tmp_path / name).touch()
    paths, args = [tmp_path / name for name in names], SimpleNamespace(**{option: 'x'})
    if not refusal:
        check_bag_options(paths, args)
        return
    with pytest.raises(ConfigError, match=refusal):
        check_bag_options(paths, args)
