//! The one printer of tables: Markdown, padded so that a terminal shows columns.

use std::fmt;

use serde::Serialize;

#[derive(Clone, Debug, Serialize)]
pub(crate) struct Table {
    pub(crate) columns: Vec<String>,
    pub(crate) rows: Vec<Vec<String>>,
}

impl Table {
    pub(crate) fn new<T: Into<String>>(columns: impl IntoIterator<Item = T>) -> Self {
        Self { columns: columns.into_iter().map(Into::into).collect(), rows: Vec::new() }
    }

    pub(crate) fn row<T: Into<String>>(&mut self, cells: impl IntoIterator<Item = T>) {
        self.rows.push(cells.into_iter().map(Into::into).collect());
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lines = || std::iter::once(&self.columns).chain(&self.rows);
        let width = |at: usize| lines().map(|line| line.get(at).map_or(0, |cell| cell.chars().count())).max();
        let widths: Vec<usize> = (0..self.columns.len()).map(|at| width(at).unwrap_or(0).max(3)).collect();
        for (number, line) in lines().enumerate() {
            for (at, width) in widths.iter().enumerate() {
                write!(f, "| {:<width$} ", line.get(at).map_or("", String::as_str))?;
            }
            writeln!(f, "|")?;
            if number == 0 {
                widths.iter().try_for_each(|width| write!(f, "|{}", "-".repeat(width + 2)))?;
                writeln!(f, "|")?;
            }
        }
        Ok(())
    }
}

/// Three digits after the point, or a dash.
pub(crate) fn figure(value: Option<f64>) -> String {
    value.map_or("-".into(), |v| format!("{v:.3}"))
}

/// A percentage, or a dash if `of` is 0.
pub(crate) fn percent(n: u64, of: u64) -> String {
    if of == 0 { "-".into() } else { format!("{:.1} %", 100.0 * n as f64 / of as f64) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned_markdown() {
        let mut table = Table::new(["scene", "n"]);
        table.row(["a".to_owned(), figure(Some(0.5))]);
        table.row(["längste".to_owned(), percent(1, 0)]);
        assert_eq!(
            table.to_string(),
            "| scene   | n     |\n|---------|-------|\n| a       | 0.500 |\n| längste | -     |\n"
        );
    }
}
