# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Every row of the tables has a test against running nodes.

Topics, services, states, values and parameters are listed here beside the test that shows what
the row says at work; `test_whole_graph` compares all of them with what the nodes declare.  A row
without a test, and a test that is gone, fail here.
"""

import ast
from pathlib import Path

from piezo_ident.nodes.interfaces import DIAGNOSTICS, SERVICES, STATES, TOPICS
from piezo_ident.nodes.parameters import NODES

HERE = Path(__file__).parent

RUN = 'test_identifier_node::test_run_drives_the_excitation_and_identifies'
STEPS = 'test_identifier_node::test_each_step_reports_what_it_found'
CANCEL = 'test_identifier_node::test_cancel_answers_at_once_and_no_sample_is_lost'
REFUSED = 'test_identifier_node::test_what_cannot_be_done_is_refused_with_the_reason'
SETTINGS = 'test_identifier_node::test_settings_reach_the_work'
SAVE = 'test_identifier_node::test_save_writes_model_report_and_pictures'
LATE = 'test_identifier_node::test_live_is_offline_and_what_comes_late_still_hears_the_model'
ASKS = 'test_diagnose_node::test_it_asks_for_what_it_lacks_and_tells_creep_from_rate_dependence'
JUDGED = 'test_diagnose_node::test_a_model_file_can_be_judged_too'
PLAY = 'test_excitation_node::test_a_programme_in_real_time'
STOP = 'test_excitation_node::test_stop_ramps_to_rest_and_goes_on_with_t'
NOBODY = 'test_excitation_node::test_nobody_listens_somebody_else_talks_and_what_comes_too_late'
FAST = 'test_excitation_node::test_faster_than_real_time_loses_nothing'
RATE = 'test_excitation_node::test_another_sample_rate_and_block_size'
BAD_PROGRAM = 'test_excitation_node::test_bad_parameters_are_refused_with_the_reason'
FAULTS = 'test_stage_node::test_every_fault_in_one_stream_sample_by_sample'
JOIN = 'test_stage_node::test_a_stream_joins_by_a_ramp_and_silence_ends_at_rest'
LIMITS = 'test_stage_node::test_limits_and_slew_may_be_set_and_hold_at_once'
THREE = 'test_side_by_side::test_three_graphs_side_by_side'
NO_MODEL = 'test_model_node::test_without_a_model_it_waits_and_says_so'
PREDICT = 'test_model_node::test_prediction_is_the_model_bit_for_bit_and_carries_t_and_segment'
FILE = 'test_model_node::test_a_model_file_is_taken_at_start_and_later'
AGAIN = 'test_model_node::test_it_says_when_to_identify_again'
RECORD = 'test_recorder_node::test_record_stop_and_refusals'
PARTS = 'test_recorder_node::test_a_long_recording_is_cut_into_parts_and_loses_nothing'
FLUSH = 'test_recorder_node::test_flush_is_how_long_a_message_waits_and_a_lost_folder_is_said'
ENDS = 'test_ends::test_in_the_middle_of_everything'
REPLAY = 'test_player_node::test_replay'
WAITING = 'test_player_node::test_refusals_and_waiting'
EARLY = 'test_player_node::test_a_bag_that_ends_early'
ANSWERED = 'test_flow_control::test_a_replay_waits_for_the_identifier_and_ends_when_it_has_all'
AS_FAST = 'test_flow_control::test_the_whole_graph_as_fast_as_all_answer'
LATCHED = 'test_whole_graph::test_what_is_latched_is_heard_by_who_comes_late'
VALUES = 'test_whole_graph::test_diagnostics_are_those_of_the_table'

COVERED = {
    'topic voltage': PLAY,
    'topic displacement': PLAY,
    'topic applied_voltage': FAULTS,
    'topic captured': ANSWERED,
    'topic prediction': PREDICT,
    'topic residual': 'test_model_node::test_residual_joins_whichever_comes_first',
    'topic preview': ('test_model_node::test_preview_holds_mean_least_and_largest_of_each_20_ms'),
    'topic model': LATE,
    'topic report': LATE,
    'topic ~/status': LATCHED,
    'topic /diagnostics': VALUES,
    'service excitation ~/start': STOP,
    'service excitation ~/stop': STOP,
    'service identifier ~/run': RUN,
    'service identifier ~/identify': REFUSED,
    'service identifier ~/identify_delay': STEPS,
    'service identifier ~/identify_dynamics': STEPS,
    'service identifier ~/identify_hysteresis': STEPS,
    'service identifier ~/diagnose': ASKS,
    'service identifier ~/cancel': CANCEL,
    'service identifier ~/clear': CANCEL,
    'service identifier ~/save': SAVE,
    'service recorder ~/start': RECORD,
    'service recorder ~/stop': RECORD,
    'service player ~/start': REPLAY,
    'service player ~/stop': REPLAY,
    'state excitation idle': PLAY,
    'state excitation waiting': NOBODY,
    'state excitation running': PLAY,
    'state excitation stopping': STOP,
    'state excitation done': PLAY,
    'state excitation stopped': STOP,
    'state excitation failed': NOBODY,
    'state stage idle': JOIN,
    'state stage running': FAULTS,
    'state stage ramping': JOIN,
    'state identifier idle': REFUSED,
    'state identifier exciting': RUN,
    'state identifier identifying': RUN,
    'state identifier diagnosing': ASKS,
    'state identifier saving': SAVE,
    'state identifier done': RUN,
    'state identifier failed': (
        'test_identifier_node::test_a_fault_that_spoils_the_data_is_a_failure_with_its_reason'
    ),
    'state identifier cancelled': CANCEL,
    'state model idle': NO_MODEL,
    'state model waiting': NO_MODEL,
    'state model predicting': NO_MODEL,
    'state recorder idle': RECORD,
    'state recorder recording': RECORD,
    'state recorder done': RECORD,
    'state recorder failed': FLUSH,
    'state player idle': REPLAY,
    'state player waiting': WAITING,
    'state player playing': REPLAY,
    'state player done': EARLY,
    'state player stopped': REPLAY,
    'state player refused': WAITING,
    'state player failed': WAITING,
    'parameter excitation.sample_rate': RATE,
    'parameter excitation.program': BAD_PROGRAM,
    'parameter excitation.block_size': RATE,
    'parameter excitation.rate_factor': FAST,
    'parameter excitation.voltage_low': BAD_PROGRAM,
    'parameter excitation.voltage_high': BAD_PROGRAM,
    'parameter excitation.rest': STOP,
    'parameter excitation.ramp_slew': STOP,
    'parameter excitation.subscribers': NOBODY,
    'parameter excitation.wait_limit': NOBODY,
    'parameter excitation.answers': AS_FAST,
    'parameter excitation.in_flight': NOBODY,
    'parameter stage.stage': THREE,
    'parameter stage.seed': PLAY,
    'parameter stage.voltage_low': LIMITS,
    'parameter stage.voltage_high': LIMITS,
    'parameter stage.slew': LIMITS,
    'parameter stage.rest': JOIN,
    'parameter stage.ramp_slew': JOIN,
    'parameter stage.silence': JOIN,
    'parameter identifier.program': RUN,
    'parameter identifier.thresholds': SETTINGS,
    'parameter identifier.solver': SETTINGS,
    'parameter identifier.polish': SETTINGS,
    'parameter identifier.max_order': SETTINGS,
    'parameter identifier.seed': SETTINGS,
    'parameter identifier.swarm_size': SETTINGS,
    'parameter identifier.swarm_iterations': SETTINGS,
    'parameter identifier.output': SAVE,
    'parameter identifier.capture_limit': (
        'test_identifier_node::test_no_more_is_kept_than_the_limit'
    ),
    'parameter identifier.excitation_limit': (
        'test_identifier_node::test_run_without_an_excitation_fails_with_the_reason'
    ),
    'parameter identifier.model': JUDGED,
    'parameter identifier.sweeps_program': ASKS,
    'parameter identifier.holds_program': ASKS,
    'parameter identifier.requests': ASKS,
    'parameter identifier.channels': ('test_identifier_node::test_a_further_channel_is_captured'),
    'parameter identifier.nice': 'test_identifier_node::test_the_work_gives_way',
    'parameter model.model': FILE,
    'parameter model.warn_ratio': AGAIN,
    'parameter model.window': AGAIN,
    'parameter model.preview_rate': FILE,
    'parameter recorder.output': RECORD,
    'parameter recorder.max_bag_size': PARTS,
    'parameter recorder.storage': 'test_recorder_node::test_sigkill_loses_less_than_a_second',
    'parameter recorder.topics': 'test_recorder_node::test_other_topics_types_and_qos',
    'parameter recorder.flush': FLUSH,
    'parameter recorder.sample_rate': RECORD,
    'parameter recorder.autostart': ENDS,
    'parameter player.bag': REPLAY,
    'parameter player.rate': REPLAY,
    'parameter player.topics': REPLAY,
    'parameter player.subscribers': WAITING,
    'parameter player.wait_limit': WAITING,
    'parameter player.answers': ANSWERED,
    'parameter player.in_flight': ANSWERED,
    'parameter player.autostart': EARLY,
    # all values of all nodes are waited for by name
    **{f'value {v.node} {v.name}': VALUES for v in DIAGNOSTICS},
}


def rows() -> set[str]:
    """Return every row of the tables."""
    return {
        *(f'topic {t.name}' for t in TOPICS),
        *(f'service {s.node} ~/{s.name}' for s in SERVICES),
        *(f'state {s.node} {s.name}' for s in STATES),
        *(f'parameter {node}.{d.name}' for node, declared in NODES.items() for d in declared),
        *(f'value {v.node} {v.name}' for v in DIAGNOSTICS),
    }


def existing() -> set[str]:
    """Return every test against running nodes."""
    return {
        f'{path.stem}::{node.name}'
        for path in HERE.glob('test_*.py')
        for node in ast.parse(path.read_text(encoding='utf-8')).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith('test_')
    }


def test_every_row_has_a_test():
    assert rows() - set(COVERED) == set(), 'rows without a test: write one, and name it here'
    assert set(COVERED) - rows() == set(), 'rows that are in no table'
    assert set(COVERED.values()) - existing() == set(), 'tests that do not exist'
