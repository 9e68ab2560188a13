use shoal_common::config::Config;
use shoal_env_server::environment::{make, names};
use shoal_run::evaluation::rollout::policy_layout;
use shoal_run::records::outcome::{RunOutcome, RunState};
use shoal_run::records::recorder::IncidentKind;
use shoal_run::testing::{run_with_policy, small};

use super::numbers::POINTS;
use super::*;

/// The data that the page's script reads.
fn data(page: &str) -> serde_json::Value {
    let (_, after) = page
        .split_once("<script type=\"application/json\" id=\"data\">")
        .unwrap();
    let (data, _) = after.split_once("</script>").unwrap();
    serde_json::from_str(data).unwrap()
}

/// A small configuration for an environment, with an algorithm that supports its spaces.
fn configuration(name: &str) -> Config {
    let algorithm = match name {
        "cart-pole" => {
            "[run]\nid = \"1a\"\nmode = \"lockstep\"\n[actors]\nchunk_steps = 200\n[replay]\nwarmup = 0\n[reinforce]\nhidden = [4, 3]\n"
        }
        "frozen-lake" => "[run]\nid = \"1a\"\n[replay]\nwarmup = 0\n[q-learning]\n",
        _ => "[run]\nid = \"1a\"\n[ddpg]\nhidden = [4, 3]\n",
    };
    let mut table: toml::Table = format!("{algorithm}[environment]\nname = \"{name}\"\n")
        .parse()
        .unwrap();
    let spec = make(name, &toml::Table::new()).unwrap().spec();
    table.insert("spec".into(), toml::Value::try_from(spec).unwrap());
    Config::from_table(table, "test").unwrap()
}

#[test]
fn episodes_of_every_environment_can_be_played() {
    let parent = tempfile::tempdir().unwrap();
    for (i, name) in names().enumerate() {
        let config = configuration(name);
        let parameters = vec![0.0; policy_layout(&config).unwrap().parameters()];
        let run = run_with_policy(parent.path(), &format!("run-{i}"), &config, Some(parameters));
        let data = data(&gather(&[run], None).unwrap().page().unwrap());
        let played = &data["runs"][0]["played"];
        assert_eq!(played["why_not"], serde_json::Value::Null, "{name}");
        let environment = make(name, &toml::Table::new()).unwrap();
        assert_eq!(
            played["picture"],
            serde_json::to_value(environment.picture()).unwrap(),
            "{name}"
        );
        assert_eq!(played["episodes"].as_array().unwrap().len(), 6, "{name}");
        let episode = &played["episodes"][0];
        let steps = episode["steps"].as_u64().unwrap() as usize;
        assert_eq!(
            episode["signals"][0]["values"].as_array().unwrap().len(),
            steps + 1,
            "{name}"
        );
    }
}

#[test]
fn a_run_without_playable_episodes_is_shown_with_the_reason() {
    let parent = tempfile::tempdir().unwrap();
    let (mut config, parameters) = small("name = \"pendulum\"");
    let begun = run_with_policy(parent.path(), "begun", &config, None);
    let damaged = run_with_policy(parent.path(), "damaged", &config, None);
    std::fs::write(damaged.best_policy(), "no policy").unwrap();
    config.environment.name = "walker".into();
    config.environment.server = vec!["no-such-program".into()];
    let served = run_with_policy(parent.path(), "served", &config, Some(parameters));
    let report = gather(&[begun, damaged, served], None).unwrap();
    let reasons = report.runs_without_episodes();
    assert_eq!(reasons.len(), 3);
    for ((reason, runs), (name, part)) in reasons.iter().zip([
        ("begun", "No policy has been evaluated yet."),
        ("damaged", "best.policy"),
        ("served", "cannot start the environment server no-such-program"),
    ]) {
        assert!(
            *runs == [name] && reason.contains(part) && !reason.contains('\n'),
            "{runs:?}: {reason}"
        );
    }
    let data = data(&report.page().unwrap());
    assert_eq!(
        data["comparisons"].as_array().unwrap().len(),
        2,
        "one for each environment"
    );
    assert_eq!(data["runs"][2]["state"], "unfinished");
}

#[test]
fn a_run_has_finished_although_the_last_report_of_its_learner_was_lost() {
    let parent = tempfile::tempdir().unwrap();
    let (config, _) = small("name = \"pendulum\"");
    let run = run_with_policy(parent.path(), "run", &config, None);
    let steps = config.run.steps;
    let learner = format!(
        "wall_seconds,env_steps,episodes,updates,policy_version,critic_loss,actor_loss,q_mean,updates_per_second,env_steps_per_second,ratio\n\
         1.0,{},3,1,1,,,,,,\n",
        steps - 1
    );
    std::fs::write(run.learner_records(), learner).unwrap();
    for (state, shown) in [(RunState::Finished, "finished"), (RunState::Failed, "unfinished")] {
        let outcome = RunOutcome::new(state, steps, 4);
        outcome.with_reason("the reason".to_owned()).write(&run).unwrap();
        let run = &data(&gather(std::slice::from_ref(&run), None).unwrap().page().unwrap())["runs"][0];
        assert_eq!((&run["state"], &run["env_steps"]), (&shown.into(), &steps.into()));
        assert!(run["why"].as_str().unwrap().contains("the reason"), "{run}");
    }
}

#[test]
fn run_names_cannot_inject_markup_and_the_page_loads_nothing() {
    let parent = tempfile::tempdir().unwrap();
    let (config, parameters) = small("name = \"pendulum\"");
    let name = "</script><script>alert(1)<!-- {{script}}";
    let run = run_with_policy(parent.path(), &name.replace('/', "∕"), &config, Some(parameters));
    let mut report = gather(&[run], None).unwrap();
    report.runs[0].name = name.into();
    let page = report.page().unwrap();
    assert!(page.starts_with(MARK));
    assert!(
        !page.contains("alert(1)<") && !page.contains("<script>alert"),
        "the name is data"
    );
    assert_eq!(data(&page)["runs"][0]["name"], name);
    assert_eq!(page.matches("<script").count(), 2);
    for foreign in ["http://", "https://", "src=", "@import", "url("] {
        // The SVG namespace is a name, not an address, and references within the page are allowed.
        let found = page.replace("http://www.w3.org/2000/svg", "").replace("url(#", "");
        assert!(!found.contains(foreign), "{foreign}");
    }
}

#[test]
fn the_page_of_a_long_run_is_small_and_shows_its_peak() {
    let parent = tempfile::tempdir().unwrap();
    let (config, parameters) = small("name = \"point-mass\"\nreward = \"r3\"");
    let run = run_with_policy(parent.path(), "long", &config, Some(parameters));
    let mut evaluations =
        String::from("wall_seconds,env_steps,updates,policy_version,return_mean,return_std,episodes,best\n");
    let mut learner = String::from(
        "wall_seconds,env_steps,episodes,updates,policy_version,critic_loss,actor_loss,q_mean,updates_per_second,env_steps_per_second,ratio\n",
    );
    let mut incidents = String::from("wall_seconds,env_steps,role,index,what,detail\n");
    for i in 0..20_000 {
        let mean = if i == 12_345 {
            777.0
        } else {
            -1_000.123_456_789 / f64::from(i + 1)
        };
        evaluations += &format!("{i}.123,{},{i},{i},{mean},12.345678,10,0\n", i * 1_000);
        learner += &format!(
            "{i}.123,{},{i},{i},{i},0.123456789,,0.5,500.123456,501.0,1.0\n",
            i * 1_000
        );
        incidents += &format!("{i}.5,{},actor,{},killed,killed by signal 9\n", i * 1_000, i % 4);
    }
    std::fs::write(run.evaluations(), evaluations).unwrap();
    std::fs::write(run.learner_records(), learner).unwrap();
    std::fs::write(run.incidents(), incidents).unwrap();
    let page = gather(&[run], None).unwrap().page().unwrap();
    assert!(page.len() < 1_000_000, "{} bytes", page.len());
    let data = data(&page);
    let run = &data["runs"][0];
    let means = run["evaluations"]["mean"].as_array().unwrap();
    assert!(means.iter().any(|mean| mean == 777.0) && means.len() <= POINTS);
    // A moving mean over the points equals the moving mean of all records.
    let total = |key: &str| -> f64 {
        let numbers = run["evaluations"][key].as_array().unwrap();
        assert_eq!(numbers.len(), means.len());
        numbers.iter().map(|number| number.as_f64().unwrap()).sum()
    };
    assert_eq!(total("counts"), 20_000.0);
    let peak = 777.0 + 1_000.123_456_789 / 12_346.0;
    let sum = peak - (1..=20_000).map(|i| 1_000.123_456_789 / f64::from(i)).sum::<f64>();
    assert!((total("sums") - sum).abs() < 1.0, "{sum}");
    assert_eq!(run["incidents"]["kills"], 20_000);
    assert_eq!(run["learner"]["actor_loss"][0], serde_json::Value::Null);
}

#[test]
fn the_time_line_has_a_sign_for_each_kind_of_incident() {
    use IncidentKind::{Failed, Fault, GivenUp, Killed, Restarted, Resumed, Retired, Scaled, Stalled};
    for kind in [
        Killed, Failed, Stalled, Fault, Restarted, GivenUp, Retired, Scaled, Resumed,
    ] {
        let name = serde_json::to_value(kind).unwrap();
        let name = name.as_str().unwrap();
        let key = if name.contains('-') {
            format!("\n  \"{name}\": [")
        } else {
            format!("\n  {name}: [")
        };
        assert!(include_str!("timeline.js").contains(&key), "{name}");
    }
}

#[test]
fn many_runs_share_the_points_and_episodes() {
    let sizes: Vec<_> = [1, 3, 5, 30, 500]
        .iter()
        .map(|runs| PageLimits::of(29, *runs))
        .map(|r| (r.points, r.episodes))
        .collect();
    assert_eq!(sizes, [(800, 6), (800, 6), (800, 4), (133, 0), (60, 0)]);
    assert_eq!(PageLimits::of(0, 500).episodes, 1);
}

#[test]
fn a_damaged_record_is_refused_with_one_line_that_names_the_file() {
    let parent = tempfile::tempdir().unwrap();
    let (config, _) = small("name = \"pendulum\"");
    let run = run_with_policy(parent.path(), "run", &config, None);
    std::fs::write(run.incidents(), "wall_seconds,env_steps\nwhen,3\n").unwrap();
    let error = format!("{:#}", gather(&[run], None).unwrap_err());
    assert!(
        error.contains("incidents.csv is not a record of this program") && !error.contains('\n'),
        "{error}"
    );
}
