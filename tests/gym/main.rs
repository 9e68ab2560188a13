//! Gymnasium environments, served from Python. Without the Python package shoal-gym these tests are ignored, or fail if
//! `SHOAL_REQUIRE_PYTHON` is set.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod answers;
mod evaluation;
mod faults;
mod films;
mod helpers;
mod processes;
#[path = "../support/suite.rs"]
mod suite;
#[path = "../support/mod.rs"]
mod support;
mod training;

use std::path::Path;
use std::process::{Command, ExitCode};

use answers::random_wrong_answers_are_survived_or_one_line_names_the_culprit;
use evaluation::{
    a_failure_in_the_final_evaluation_costs_an_episode_or_a_line, a_signal_ends_shoal_eval_in_order,
    a_signal_ends_the_final_evaluation_in_order,
    an_evaluator_killed_while_it_confirms_a_policy_repeats_nothing_it_reported,
};
use faults::{
    a_failing_environment_ends_the_run_with_its_last_output,
    a_lockstep_run_begins_another_episode_after_an_invalid_answer,
    an_invalid_answer_ends_its_episodes_and_is_counted_and_named,
    each_kind_of_wrong_answer_is_survived_or_one_line_names_the_server, episodes_that_never_end_are_named,
    too_many_invalid_answers_end_a_run_that_can_be_resumed,
};
use films::{an_environment_without_frames_says_why, frames_are_filmed_and_played_in_the_report};
use helpers::place;
use processes::{
    a_child_process_of_an_environment_blocks_nothing, a_killed_start_leaves_no_process_and_no_file,
    a_module_sees_no_arguments_and_no_input_and_prints_to_the_log,
    a_run_remembers_where_its_server_is_started_and_with_what, a_run_with_another_program_may_lie_at_any_path,
    a_server_that_ignores_requests_is_replaced, a_server_that_was_stopped_continues,
    a_slow_environment_is_not_replaced, a_stuck_server_ends_with_its_launcher,
    an_environments_output_takes_bounded_memory_and_cannot_control_the_terminal,
    servers_end_with_their_launcher_and_the_run_can_be_resumed, the_status_of_a_run_that_starts_says_so,
};
use suite::{PYTHON, test};
use support::output_of;
use training::{
    a_gymnasium_pendulum_is_trained_while_its_servers_are_killed, a_resumed_lockstep_run_begins_other_episodes,
    an_unsupported_environment_is_refused_in_one_line_and_leaves_no_run,
    discrete_spaces_with_an_offset_are_learned_by_a_table, environments_receive_seeds_and_lockstep_runs_are_repeatable,
    termination_and_truncation_are_distinguished,
};

fn main() -> ExitCode {
    suite::run(vec![
        test!(the_package_passes_its_own_tests, PYTHON),
        test!(a_gymnasium_pendulum_is_trained_while_its_servers_are_killed, PYTHON),
        test!(environments_receive_seeds_and_lockstep_runs_are_repeatable, PYTHON),
        test!(a_resumed_lockstep_run_begins_other_episodes, PYTHON),
        test!(termination_and_truncation_are_distinguished, PYTHON),
        test!(episodes_that_never_end_are_named, PYTHON),
        test!(a_lockstep_run_begins_another_episode_after_an_invalid_answer, PYTHON),
        test!(discrete_spaces_with_an_offset_are_learned_by_a_table, PYTHON),
        test!(a_failing_environment_ends_the_run_with_its_last_output, PYTHON),
        test!(
            an_unsupported_environment_is_refused_in_one_line_and_leaves_no_run,
            PYTHON
        ),
        test!(servers_end_with_their_launcher_and_the_run_can_be_resumed, PYTHON),
        test!(bench_gym_compares_with_gymnasiums_own_vectors, PYTHON),
        test!(a_child_process_of_an_environment_blocks_nothing, PYTHON),
        test!(
            an_environments_output_takes_bounded_memory_and_cannot_control_the_terminal,
            PYTHON
        ),
        test!(a_stuck_server_ends_with_its_launcher, PYTHON),
        test!(the_status_of_a_run_that_starts_says_so, PYTHON),
        test!(a_killed_start_leaves_no_process_and_no_file, PYTHON),
        test!(a_server_that_ignores_requests_is_replaced, PYTHON),
        test!(an_invalid_answer_ends_its_episodes_and_is_counted_and_named, PYTHON),
        test!(too_many_invalid_answers_end_a_run_that_can_be_resumed, PYTHON),
        test!(
            each_kind_of_wrong_answer_is_survived_or_one_line_names_the_server,
            PYTHON
        ),
        test!(random_wrong_answers_are_survived_or_one_line_names_the_culprit, PYTHON),
        test!(
            an_evaluator_killed_while_it_confirms_a_policy_repeats_nothing_it_reported,
            PYTHON
        ),
        test!(a_module_sees_no_arguments_and_no_input_and_prints_to_the_log, PYTHON),
        test!(a_slow_environment_is_not_replaced, PYTHON),
        test!(a_run_remembers_where_its_server_is_started_and_with_what, PYTHON),
        test!(a_run_with_another_program_may_lie_at_any_path, PYTHON),
        test!(a_failure_in_the_final_evaluation_costs_an_episode_or_a_line, PYTHON),
        test!(a_signal_ends_the_final_evaluation_in_order, PYTHON),
        test!(a_signal_ends_shoal_eval_in_order, PYTHON),
        test!(a_server_that_was_stopped_continues, PYTHON),
        test!(frames_are_filmed_and_played_in_the_report, PYTHON),
        test!(an_environment_without_frames_says_why, PYTHON),
    ])
}

fn the_package_passes_its_own_tests() {
    let mut tests = Command::new("python3");
    tests
        .args(["-B", "-m", "unittest", "discover", "-s", "tests"])
        .current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("python"));
    let output = output_of(&mut tests);
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && !message.contains("Ran 0 tests"), "{message}");
}

fn bench_gym_compares_with_gymnasiums_own_vectors() {
    let place = place();
    let mut bench = place.shoal(&["bench", "gym", "--json"]);
    let output = support::output_of(bench.env("SHOAL_BENCH_SECONDS", "0.4"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let figures = support::json(&output);
    let number = |field: &str| figures[field].as_f64().unwrap();
    assert!(0.0 < number("round_trip_median_us"));
    assert!(number("round_trip_median_us") <= number("round_trip_p99_us"));
    for vector in ["", "sync_vector_", "async_vector_"] {
        assert!(number(&format!("{vector}steps_per_second")) > 0.0, "{figures}");
    }
}
