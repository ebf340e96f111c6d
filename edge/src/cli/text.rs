//! Text for a terminal: tables, and names that are safe to print.

/// Formats rows as right-aligned columns under a header.
pub fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let width_of = |column: usize| {
        let cells = rows.iter().map(|row| row[column].chars().count());
        cells.chain([head[column].chars().count()]).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..head.len()).map(width_of).collect();
    let line = |cells: &mut dyn Iterator<Item = &str>| {
        let padded: Vec<String> = cells.zip(&widths).map(|(cell, width)| format!("{cell:>width$}")).collect();
        padded.join("  ") + "\n"
    };
    let mut text = line(&mut head.iter().copied());
    text.extend(rows.iter().map(|row| line(&mut row.iter().map(String::as_str))));
    text
}

/// Escapes control characters: names come from files, and terminals obey control characters.
pub fn visible(text: &str) -> String {
    text.chars()
        .flat_map(|c| if c.is_control() { c.escape_default().collect::<Vec<_>>() } else { vec![c] })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_align_and_control_bytes_show() {
        let text = table(
            &["a", "long head"],
            &[vec!["12".into(), "é".into()], vec!["3".into(), "long content".into()]],
        );
        assert_eq!(text, " a     long head\n12             é\n 3  long content\n");
        assert_eq!(visible("yard\u{1b}[2J\n"), "yard\\u{1b}[2J\\n");
    }
}
