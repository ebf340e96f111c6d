//! A page of results in one file: headings, tables and pictures inline, no scripts, nothing from elsewhere. It
//! opens from a disk, an e-mail or a web server alike.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;

/// Rows shown of a table; the rest is counted, because browsers are slow with more.
const MAX_ROWS: usize = 5000;
/// Allows inline styles and pictures, nothing else.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; img-src data:";
const STYLE: &str = "\
:root{color-scheme:light dark;font:15px/1.5 system-ui,sans-serif}\
body{margin:0 auto;max-width:1100px;padding:24px}\
h1{font-size:22px}h2{font-size:17px;margin-top:32px}\
p{max-width:75ch}pre{overflow:auto}\
.wide{overflow:auto;max-height:70vh}\
table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}\
caption{text-align:left;padding:4px 0}\
th,td{padding:3px 10px;border-bottom:1px solid #8886;text-align:left;vertical-align:top}\
td.n{text-align:right;white-space:nowrap}thead th{position:sticky;top:0;background:Canvas}\
figure{margin:12px 0;display:inline-block;vertical-align:top}figcaption{font-size:13px}\
img,svg{max-width:100%;height:auto}svg{background:#fff;color:#111}";

pub(crate) struct Page {
    title: String,
    body: String,
}

pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

impl Page {
    pub(crate) fn new(title: &str) -> Self {
        Self { title: escaped(title), body: String::new() }
    }

    fn add(&mut self, what: std::fmt::Arguments<'_>) {
        // Writing to a string does not fail.
        self.body.write_fmt(what).unwrap_or_default();
    }

    pub(crate) fn heading(&mut self, text: &str) {
        self.add(format_args!("<h2>{}</h2>\n", escaped(text)));
    }

    pub(crate) fn paragraph(&mut self, text: &str) {
        self.add(format_args!("<p>{}</p>\n", escaped(text)));
    }

    /// Adds unescaped SVG, which this program made.
    pub(crate) fn drawing(&mut self, svg: &str, caption: &str) {
        self.add(format_args!("<figure>{svg}<figcaption>{}</figcaption></figure>\n", escaped(caption)));
    }

    pub(crate) fn picture(&mut self, jpeg: &[u8], caption: &str) {
        let (data, caption) = (STANDARD.encode(jpeg), escaped(caption));
        self.add(format_args!(
            "<figure><img alt=\"{caption}\" src=\"data:image/jpeg;base64,{data}\"><figcaption>{caption}</figcaption></figure>\n"
        ));
    }

    /// Adds a table; missing cells are left out. Numbers are right-aligned.
    pub(crate) fn table(&mut self, columns: &[&str], rows: &[Vec<String>]) {
        self.body.push_str("<div class=\"wide\" tabindex=\"0\"><table><thead><tr>");
        for column in columns {
            self.add(format_args!("<th scope=\"col\">{}</th>", escaped(column)));
        }
        self.body.push_str("</tr></thead><tbody>\n");
        for row in rows.iter().take(MAX_ROWS) {
            self.body.push_str("<tr>");
            for cell in row {
                let class = if cell.parse::<f64>().is_ok() { " class=\"n\"" } else { "" };
                self.add(format_args!("<td{class}>{}</td>", escaped(cell)));
            }
            self.body.push_str("</tr>\n");
        }
        self.body.push_str("</tbody></table></div>\n");
        if let Some(more) = rows.len().checked_sub(MAX_ROWS).filter(|more| *more > 0) {
            self.paragraph(&format!("{more} more rows are left out."));
        }
    }

    /// Adds a result from its JSON: single values as one table, then a titled table for each list of records and each
    /// record of columns.
    pub(crate) fn value(&mut self, value: &Value) {
        let Some(members) = value.as_object() else { return };
        let is_single = |value: &&Value| !is_list_of_records(value) && !is_of_columns(value);
        let single: Vec<Vec<String>> = (members.iter())
            .filter(|(_, value)| is_single(value))
            .map(|(name, value)| vec![name.replace('_', " "), shown(value)])
            .collect();
        if !single.is_empty() {
            self.table(&["", ""], &single);
        }
        for (name, value) in members.iter().filter(|(_, value)| !is_single(value)) {
            self.heading(&name.replace('_', " "));
            self.records(value);
        }
    }

    /// Adds the table of a list of records, or of a record of columns.
    pub(crate) fn records(&mut self, value: &Value) {
        if let Some(columns) = value.as_object().filter(|_| is_of_columns(value)) {
            let names: Vec<&str> = columns.keys().map(String::as_str).collect();
            let n = columns.values().filter_map(|column| column.as_array()).map(Vec::len).max().unwrap_or(0);
            let row = |at| columns.values().map(|column| shown(&column[at])).collect();
            return self.table(&names, &(0..n).map(row).collect::<Vec<_>>());
        }
        let records: Vec<_> = value.as_array().into_iter().flatten().filter_map(Value::as_object).collect();
        let mut names: Vec<&str> = Vec::new();
        for name in records.iter().flat_map(|record| record.keys()) {
            if !names.contains(&name.as_str()) {
                names.push(name);
            }
        }
        let row = |record: &&serde_json::Map<String, Value>| {
            names.iter().map(|name| record.get(*name).map_or(String::new(), shown)).collect()
        };
        let rows: Vec<Vec<String>> = records.iter().map(row).collect();
        self.table(&names.clone(), &rows);
    }

    pub(crate) fn finish(self) -> String {
        let Self { title, body } = self;
        format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
             <meta http-equiv=\"Content-Security-Policy\" content=\"{POLICY}\">\
             <title>{title}</title><style>{STYLE}</style></head>\n<body><h1>{title}</h1>\n{body}</body></html>\n"
        )
    }
}

fn is_list_of_records(value: &Value) -> bool {
    value.as_array().is_some_and(|list| !list.is_empty() && list.iter().all(Value::is_object))
}

/// Whether a value is a record of lists of equal length.
fn is_of_columns(value: &Value) -> bool {
    let Some(members) = value.as_object() else { return false };
    let mut lens = members.values().map(|column| column.as_array().map(Vec::len));
    let first = lens.next().flatten();
    first.is_some() && lens.all(|len| len == first)
}

/// Formats a value for people: numbers with four digits, lists with commas.
fn shown(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::String(text) => text.clone(),
        Value::Number(number) => match number.as_f64().filter(|_| number.is_f64()) {
            Some(float) if float != 0.0 && float.abs() < 0.001 => format!("{float:.3e}"),
            Some(float) => {
                let n_decimals = (3.0 - float.abs().max(1.0).log10().floor()).max(0.0) as usize;
                format!("{float:.n_decimals$}")
            }
            None => number.to_string(),
        },
        Value::Array(list) => list.iter().map(shown).collect::<Vec<_>>().join(", "),
        Value::Object(members) => members
            .iter()
            .map(|(name, value)| format!("{name} {}", shown(value)))
            .collect::<Vec<_>>()
            .join(", "),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests;
