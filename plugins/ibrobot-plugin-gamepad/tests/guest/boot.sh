#!/bin/sh
# Boots a Debian kernel under QEMU on this machine's own file system, read-only, and jogs the simulated arm there with
# devices made by uhid and uinput. Needs: apt-get install qemu-system-x86 busybox-static cpio kmod, root, and a kernel
# package unpacked into a folder (apt-get download linux-image-6.1.0-…-amd64; dpkg -x PACKAGE FOLDER).
#
#     sh boot.sh FOLDER PYTHON [DEVICE…]
set -eu
here=$(cd "$(dirname "$0")" && pwd)
kernel=$1 python=$2
shift 2
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
version=$(ls "$kernel/lib/modules")
mkdir -p "$work/root/bin" "$work/root/lib/modules" "$work/root/new"
cp "$(command -v busybox)" "$work/root/bin/busybox"
depmod -b "$kernel" "$version"
order=""
for module in virtio_pci 9pnet_virtio 9p uhid uinput evdev joydev hid-generic hid-playstation hid-sony hid-microsoft; do
    for file in $(modprobe -d "$kernel" -S "$version" --show-depends "$module" | sed -n 's/^insmod //p'); do
        cp "$file" "$work/root/lib/modules/"
        order="$order $(basename "$file")"
    done
done
cat > "$work/root/init" <<EOF
#!/bin/busybox sh
/bin/busybox mkdir -p /proc
/bin/busybox mount -t proc none /proc
for module in $order; do /bin/busybox insmod /lib/modules/\$module 2>/dev/null; done
/bin/busybox mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=262144 host /new || echo "guest: no file system"
for each in tmp run; do /bin/busybox mount -t tmpfs none /new/\$each; done
/bin/busybox mount -t devtmpfs none /new/dev
/bin/busybox mount -t proc none /new/proc
/bin/busybox mount -t sysfs none /new/sys
cd /
/bin/busybox chroot /new /usr/bin/env HOME=/tmp PATH=/usr/bin:/bin PYTHONPATH=$(dirname "$(dirname "$here")") PYTHONDONTWRITEBYTECODE=1 OMP_NUM_THREADS=1 \
    $python $here/jog_in_guest.py $* 2>&1
/bin/busybox poweroff -f
EOF
chmod +x "$work/root/init"
(cd "$work/root" && find . | cpio -o -H newc --quiet | gzip -1) > "$work/initrd"
qemu-system-x86_64 -m 3072 -smp 2 -cpu max -accel tcg,thread=multi -nographic -no-reboot \
    -kernel "$kernel"/boot/vmlinuz-* -initrd "$work/initrd" -append "console=ttyS0 quiet panic=-1 rdinit=/init" \
    -virtfs local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap
