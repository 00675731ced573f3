# SPDX-License-Identifier: Apache-2.0

"""An SFTP server of a folder on this machine, for the user `robot`; it prints its port."""

import asyncio
import sys

import asyncssh


class Server(asyncssh.SSHServer):
    """Accepts one user."""

    def begin_auth(self, username):
        """Ask for a password."""
        return True

    def password_auth_supported(self):
        """Offer passwords."""
        return True

    def validate_password(self, username, password):
        """Compare user and password."""
        return (username, password) == ('robot', 'secret')


async def serve(folder):
    """Serve a folder as the root."""
    server = await asyncssh.listen(
        '127.0.0.1', 0, server_factory=Server,
        server_host_keys=[asyncssh.generate_private_key('ssh-ed25519')],
        sftp_factory=lambda connection: asyncssh.SFTPServer(connection, chroot=folder))
    print(server.get_port(), flush=True)
    await server.wait_closed()


if __name__ == '__main__':
    asyncio.run(serve(sys.argv[1]))
