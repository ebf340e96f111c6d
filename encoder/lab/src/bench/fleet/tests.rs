//! By hand.

use slag_encoder::encode::ViewCost;

use super::FleetReport;
use super::simulate::{Handing, Links, Work, wall_secs};

fn work(views_secs: &[f64], len_bytes: u64) -> Work {
    let views = views_secs.iter().map(|secs| ViewCost { secs: *secs, len_bytes }).collect();
    Work { views, cells_secs: vec![3.0, 1.0], coordinator_secs: 10.0 }
}

const FAST: Links = Links { worker_bits_per_s: 1e18, coordinator_bits_per_s: 1e18, dispatch_secs: 0.0 };

/// Views of 1, 1, 1, 5 s and cells of 3, 1 s on two machines. The queue begins with 5: views end at 5, cells at 3. Batches
/// are 1 + 1 and 1 + 5.
#[test]
fn two_machines_by_hand() {
    let work = work(&[1.0, 1.0, 1.0, 5.0], 0);
    assert!((wall_secs(&work, &FAST, 2, Handing::Queue) - 18.0).abs() < 1e-9);
    assert!((wall_secs(&work, &FAST, 2, Handing::Batches) - 19.0).abs() < 1e-9);
    assert!((wall_secs(&work, &FAST, 1, Handing::Queue) - 22.0).abs() < 1e-9);
    let slow = Links { dispatch_secs: 0.5, ..FAST };
    // 5.5 beside 3 times 1.5; cells 3.5.
    assert!((wall_secs(&work, &slow, 2, Handing::Queue) - 19.0).abs() < 1e-9);
}

/// Four views of 8 bits each end at 1 + 1 s on four machines; the coordinator brings them home in 4 times 2 s. Cells read 16
/// bits.
#[test]
fn the_coordinators_link_is_shared() {
    let links = Links { worker_bits_per_s: 8.0, coordinator_bits_per_s: 4.0, dispatch_secs: 0.0 };
    let secs = wall_secs(&work(&[1.0; 4], 1), &links, 4, Handing::Queue);
    assert!((secs - (2.0 + 8.0 + 10.0 + 3.0 + 2.0)).abs() < 1e-9, "{secs}");
}

/// 64 equal views, no coordinator: all machines pay up to 64.
#[test]
fn more_machines_pay_up_to_the_number_of_views() {
    let work = Work { cells_secs: Vec::new(), coordinator_secs: 0.0, ..work(&[1.0; 16], 0) }.repeated(64);
    let report = FleetReport::simulate(&work, &FAST, 256);
    assert_eq!((report.n_views, report.pays_until), (64, [64, 64]));
    assert!(report.rows.iter().all(|row| row.n > 64 || (row.efficiency - 1.0).abs() < 1e-9));
    let of_other_models = work.with_view_secs(3.0);
    assert!(of_other_models.views.iter().all(|view| (view.secs - 3.0).abs() < 1e-12));
    assert!(report.svg().contains("batches made beforehand"));
}
