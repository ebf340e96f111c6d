//! Bind groups and dispatches of compute kernels.

use std::collections::HashMap;

use super::device::Device;

pub fn whole(buffer: &wgpu::Buffer) -> wgpu::BufferBinding<'_> {
    buffer.as_entire_buffer_binding()
}

/// Numbers bindings from 0 on.
pub fn number<'a>(bindings: &[wgpu::BufferBinding<'a>]) -> Vec<(u32, wgpu::BufferBinding<'a>)> {
    (0..).zip(bindings.iter().cloned()).collect()
}

pub fn bind(
    device: &Device,
    kernel: &wgpu::ComputePipeline,
    bound: &[(u32, wgpu::BufferBinding<'_>)],
) -> wgpu::BindGroup {
    let entries: Vec<_> = bound
        .iter()
        .map(|(binding, buffer)| wgpu::BindGroupEntry {
            binding: *binding,
            resource: wgpu::BindingResource::Buffer(buffer.clone()),
        })
        .collect();
    device.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &kernel.get_bind_group_layout(0),
        entries: &entries,
    })
}

/// Returns the bind group with this name and number, and creates it at the first use.
pub(crate) fn cached<'g>(
    groups: &'g mut HashMap<(&'static str, u32), wgpu::BindGroup>,
    key: (&'static str, u32),
    make: impl FnOnce() -> wgpu::BindGroup,
) -> &'g wgpu::BindGroup {
    groups.entry(key).or_insert_with(make)
}

/// Records a kernel with `n` workgroups along x and y.
pub(crate) fn dispatch(
    pass: &mut wgpu::ComputePass<'_>,
    kernel: &wgpu::ComputePipeline,
    group: &wgpu::BindGroup,
    n: [u32; 2],
) {
    pass.set_pipeline(kernel);
    pass.set_bind_group(0, group, &[]);
    pass.dispatch_workgroups(n[0], n[1], 1);
}

/// Records a kernel with the number of workgroups from a buffer.
pub(crate) fn dispatch_indirect(
    pass: &mut wgpu::ComputePass<'_>,
    kernel: &wgpu::ComputePipeline,
    group: &wgpu::BindGroup,
    (sizes, offset): (&wgpu::Buffer, u64),
) {
    pass.set_pipeline(kernel);
    pass.set_bind_group(0, group, &[]);
    pass.dispatch_workgroups_indirect(sizes, offset);
}
