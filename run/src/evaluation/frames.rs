//! Pictures of an episode's states.

use shoal_env_server::frame::{Frame, Written};

/// Pictures of an episode's states 0, `stride`, 2 · `stride`, …, and of the last state if there is one of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Frames {
    /// Steps between pictures; fewer before the last one.
    pub stride: usize,
    /// At least the picture of the first state.
    pub frames: Vec<Frame>,
    /// How many steps are meant to be shown in a second, if the environment's server says so.
    pub fps: Option<f64>,
}

/// Collects the pictures of an episode as it is played. A long episode is thinned out: whenever there are more than
/// `max_frames`, every second one is dropped.
pub(super) struct FrameCollector {
    max_frames: usize,
    stride: usize,
    frames: Vec<Frame>,
    fps: Option<f64>,
    why_not: Option<String>,
}

impl FrameCollector {
    /// At most `max_frames` pictures, but at least two, of every state or of every `stride`th.
    pub(super) fn new(max_frames: usize, stride: usize) -> Self {
        Self {
            max_frames: max_frames.max(2),
            stride: stride.max(1),
            frames: Vec::new(),
            fps: None,
            why_not: None,
        }
    }

    /// Whether it keeps a picture of the state after this many steps.
    pub(super) fn wants(&self, steps: usize) -> bool {
        self.why_not.is_none() && steps.is_multiple_of(self.stride)
    }

    /// Adds what was written of a state that it wants.
    pub(super) fn add(&mut self, written: Option<Written>) {
        match written {
            Some(Written { frame: Ok(frame), fps }) => {
                self.fps = fps;
                self.push(frame);
            }
            Some(Written { frame: Err(reason), .. }) => self.why_not = Some(reason),
            None => self.why_not = Some("the environment's server writes no pictures".into()),
        }
    }

    /// Adds the last state's picture, whether or not it is wanted.
    pub(super) fn add_last(&mut self, frame: Option<Frame>) {
        if self.why_not.is_none() {
            self.frames.extend(frame);
        }
    }

    fn push(&mut self, frame: Frame) {
        self.frames.push(frame);
        if self.frames.len() > self.max_frames {
            keep_every_second(&mut self.frames);
            self.stride *= 2;
        }
    }

    /// The pictures, or the reason why there are none.
    pub(super) fn finish(self) -> Result<Frames, String> {
        match self.why_not {
            Some(reason) => Err(reason),
            None => Ok(Frames {
                stride: self.stride,
                frames: self.frames,
                fps: self.fps,
            }),
        }
    }
}

/// Keeps the first, third, fifth, … item.
pub fn keep_every_second<T>(items: &mut Vec<T>) {
    let mut number = 0;
    items.retain(|_| {
        number += 1;
        number % 2 == 1
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_env_server::frame::Image;

    fn picture(number: usize) -> Frame {
        Frame::Image(Image {
            width: number,
            height: 0,
            rgb: Vec::new(),
        })
    }

    #[test]
    fn a_long_episode_is_thinned_out_evenly() {
        for (steps, max_frames, stride) in [(4, 10, 1), (9, 10, 1), (10, 10, 2), (100, 10, 16), (1000, 7, 256)] {
            let mut collector = FrameCollector::new(max_frames, 1);
            for step in 0..=steps {
                if collector.wants(step) {
                    let frame = Ok(picture(step));
                    collector.add(Some(Written { frame, fps: Some(20.0) }));
                }
            }
            let frames = collector.finish().unwrap();
            let expected: Vec<Frame> = (0..=steps).step_by(stride).map(picture).collect();
            assert_eq!((frames.stride, frames.frames), (stride, expected), "{steps} steps");
            assert_eq!(frames.fps, Some(20.0));
        }
    }

    #[test]
    fn a_reason_ends_the_recording() {
        let mut collector = FrameCollector::new(5, 1);
        let frame = Err("no pygame".to_owned());
        collector.add(Some(Written { frame, fps: None }));
        assert!(!collector.wants(1));
        assert_eq!(collector.finish(), Err("no pygame".into()));
        let mut silent = FrameCollector::new(5, 1);
        silent.add(None);
        assert!(silent.finish().unwrap_err().contains("no pictures"));
    }
}
