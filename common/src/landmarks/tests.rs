use super::*;
use crate::container::{self, AlignedBytes};

const MAGIC: [u8; 8] = *b"LANDMARK";

fn landmark(x: f64, code: u128, view: u16) -> Landmark {
    Landmark { position_in_world: DVec3::new(x, -2.0, 1e6), code, view }
}

fn written(sections: &[(u32, &[u8])]) -> AlignedBytes {
    let mut bytes = Vec::new();
    container::write(&mut bytes, MAGIC, 1, sections).expect("memory");
    AlignedBytes::copy_of(&bytes)
}

fn checked(bytes: &AlignedBytes) -> Result<Option<Landmarks<'_>>, ContainerError> {
    let layout = Layout::check(bytes, MAGIC, 1)?;
    check(bytes, &layout).map(|()| Landmarks::of(bytes, &layout))
}

/// By hand: the ends of an axis are exact, a third of it is the nearest of 65,535 steps; an axis without extent has
/// one position; non-finite positions are dropped.
#[test]
fn landmarks_come_back_by_hand() {
    let code = 0x0123_4567_89ab_cdef_0011_2233_4455_6677;
    let built = BuiltLandmarks::pack(
        7,
        &[
            landmark(-1.0, code, 3),
            landmark(f64::NAN, 1, 1),
            landmark(0.0, 1, u16::MAX),
            landmark(2.0, 1 << 127, 0),
        ],
    );
    let sections = built.view().expect("landmarks").sections();
    // Little-endian: 16 bytes of the first record's code.
    assert_eq!(sections[1].1[8..24], code.to_le_bytes());
    let bytes = written(&sections);
    let view = checked(&bytes).expect("sound").expect("there");
    assert_eq!((view.header.code_version, view.len()), (7, 3));
    let found: Vec<_> = view.iter().collect();
    let seen = found.iter().map(|l| (l.code, l.view)).collect::<Vec<_>>();
    assert_eq!(seen, [(code, 3), (1, u16::MAX), (1 << 127, 0)]);
    for (found, x) in found.iter().zip([-1.0, 0.0, 2.0]) {
        let expected = DVec3::new(x, -2.0, 1e6);
        assert!(found.position_in_world.distance(expected) <= 3.0 / 65_535.0 / 2.0 + 1e-9, "{found:?}");
    }
    assert_eq!(BuiltLandmarks::pack(7, &[]).view(), None);
}

#[test]
fn faults_are_refused_by_name() {
    let built = BuiltLandmarks::pack(1, &[landmark(0.0, 5, 0), landmark(1.0, 6, 1)]);
    let [header, records] = built.view().expect("landmarks").sections();
    let refused = |header: &[u8], records: &[u8]| {
        let bytes = written(&[(section::HEADER, header), (section::LANDMARKS, records)]);
        checked(&bytes).expect_err("must be refused").to_string()
    };
    let edited = |edit: fn(&mut LandmarksHeader)| {
        let mut header = built.header;
        edit(&mut header);
        refused(bytemuck::bytes_of(&header), records.1)
    };
    assert!(edited(|h| h.step[1] = 0.0).contains("steps above 0"));
    assert!(edited(|h| h.step[2] = f64::NAN).contains("steps above 0"));
    assert!(edited(|h| h.step[0] = f64::MAX).contains("finite positions"));
    assert!(edited(|h| h.origin_in_world[0] = f64::INFINITY).contains("finite positions"));
    assert!(refused(header.1, &records.1[..47]).contains("landmarks"));
    assert!(refused(&header.1[..55], records.1).contains("header of the landmarks"));
    assert!(checked(&written(&[header])).expect_err("must be refused").to_string().contains("landmarks"));
    assert!(checked(&written(&[records])).expect("without a header there are none").is_none());
}
